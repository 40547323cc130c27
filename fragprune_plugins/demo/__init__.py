"""A scene, a host and a run of both, so that fragprune can be seen working on any laptop.

Nothing is downloaded: the photographs are ray-traced (``scene.py``), the host is a small training
repository of our own in vanilla 3DGS's public shape (``host/``), and ``fragprune demo`` takes both
through the same injection that a real repository gets.
"""
