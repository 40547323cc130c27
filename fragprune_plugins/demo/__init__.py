"""A scene, a host and a run of both, which show fragprune at work on any laptop.

Nothing is downloaded. ``scene.py`` ray-traces the photographs. The host is our own small training
repository in vanilla 3DGS's public shape (``host/``). ``fragprune demo`` runs the host through the
same injection as any real repository.
"""
