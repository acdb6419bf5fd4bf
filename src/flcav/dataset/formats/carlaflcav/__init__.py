"""Raw recordings of CarlaFLCAV's FLDatasetTool: their labels (`labels.py`), and their reading as frames (`read.py`)."""
