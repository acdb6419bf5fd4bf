"""MCAP files with Foxglove's schemas: they open in Foxglove, and in whatever reads MCAP."""

from flcav.dataset.formats.mcap.write import export_mcap

__all__ = ["export_mcap"]
