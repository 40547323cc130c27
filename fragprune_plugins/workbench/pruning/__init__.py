"""Which Gaussians can go: scores over views, and Gaussians that no view shows."""
