"""The demo with several arms over seeds: what each stage and sensor is worth."""
