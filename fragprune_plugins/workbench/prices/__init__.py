"""What a frame costs on one machine: prices, their measurement, and predictions from them."""
