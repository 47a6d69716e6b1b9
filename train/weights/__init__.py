"""Weights that a training begins with: files of PyTorch, read without it, and networks trained before."""
