"""Storage of results: atomic writing, JSON records, Parquet and CSV tables, Markdown."""
