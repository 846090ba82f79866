"""The scene as a function of camera and instant (Eqs. 1-9)."""
