"""Labels of stages II and III: their sources, pseudo-labels, the road average, and their quality."""
