"""Reports for people: text, tables and figures."""
