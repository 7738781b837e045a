"""One reader and one writer a format: robot YAML, URDF, tables, job. The only place that converts units."""
