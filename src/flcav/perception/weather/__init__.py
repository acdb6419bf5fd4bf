"""Weather classification of camera images, by LeNet-5."""
