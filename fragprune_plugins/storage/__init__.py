"""Files of models and of what was learned about them, written whole or not at all."""
