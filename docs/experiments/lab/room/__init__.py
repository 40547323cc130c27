"""Makes the photographs that the demo ships: a ray tracer and a small room."""
