"""MCAP files with Foxglove's schemas, for Foxglove and any other reader of MCAP: written (`write`)."""
