"""2D detection of traffic signs and traffic lights in camera images, by a YOLOv5-style detector."""
