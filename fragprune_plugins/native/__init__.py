"""Sources and builds of the compiled engines; ``engines.cpu`` and ``engines.cuda`` open them."""
