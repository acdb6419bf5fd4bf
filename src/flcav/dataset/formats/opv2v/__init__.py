"""OPV2V: its `files`, a source of frames (`read`), the export (`write`). Xu et al., "OPV2V", ICRA 2022."""
