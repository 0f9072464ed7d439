"""Files in and out: CSV for people's tables, YAML for plans and estimates."""
