"""Networks fill view tables, view tables are walked, walks become metrics, metrics become a report."""
