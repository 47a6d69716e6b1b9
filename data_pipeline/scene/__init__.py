"""Objects out of a recorded scene: the surfaces that hold them, where each is, and which pixels show it."""
