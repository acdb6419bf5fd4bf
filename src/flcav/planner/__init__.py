"""The planner: placements and plans in a browser, on the loopback interface, and the tables that users bring to them.

`placing.py` and `planning.py` compute, `server.py` answers the page; `web/` has the sources of the page, which esbuild
bundles to `assets/`.
"""
