"""Signs and traffic lights in camera pictures (a YOLOv5-style detector)."""
