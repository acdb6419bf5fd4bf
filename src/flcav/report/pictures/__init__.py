"""Pictures of sensor data, annotations, predictions and towns."""
