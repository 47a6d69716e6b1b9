"""What objects look like from all directions, and what follows from views that are compared with it."""
