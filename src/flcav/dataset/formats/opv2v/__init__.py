"""OPV2V: written (`write`) and read (`read`). Xu et al., "OPV2V", ICRA 2022."""
