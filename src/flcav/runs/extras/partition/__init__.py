"""Non-IID data: a region's training samples are dealt to its vehicles by class, place or amount."""
