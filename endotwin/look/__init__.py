"""Pictures and windows that show a twin, and a trajectory in it."""
