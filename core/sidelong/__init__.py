"""sidelong: choose the few camera views that complete the depth of shiny parts.

The planner library. It holds no web, vendor or process code: ``for step in scan(...)`` runs in a notebook.
"""
