"""Evaluation: view tables from networks, walks over view tables, metrics of walks, and the report."""
