"""Export to MCAP files with Foxglove's schemas, for Foxglove and any other reader of MCAP."""

from flcav.dataset.formats.mcap.write import export_mcap

__all__ = ["export_mcap"]
