"""Several processes that hold one model: replicas of it, or a part of its Gaussians each."""
