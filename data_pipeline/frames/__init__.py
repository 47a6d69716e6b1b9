"""Recorded depth images with their cameras, from files of several forms: `read_frames` in `reading`."""
