"""Commands about datasets: record, validate, view, draw, export."""
