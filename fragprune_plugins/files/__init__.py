"""Files of models, thresholds and records. A file is written completely or not at all."""
