"""Files that hold results: atomic writing, JSON records, Parquet and CSV tables, Markdown."""
