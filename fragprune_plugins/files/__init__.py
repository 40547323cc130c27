"""Files of models and thresholds. A file is written completely or not at all."""
