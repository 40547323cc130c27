"""How thresholds learn, for any driver: this room knows neither a host nor a data set."""
