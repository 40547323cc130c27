"""A viewer in the browser: a model's tables, the pages that draw them, and a local server.

``packing`` makes a model's tables, ``site`` the files of a whole viewer, ``server`` serves them.
What runs in the browser is in ``static``: plain modules of JavaScript, with no build step.
"""
