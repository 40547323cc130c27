"""Mathematics that belongs to no model."""
