"""Reports of results: figures, Markdown tables and HTML pages."""
