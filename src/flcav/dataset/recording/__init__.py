"""Recording of datasets: the recorder, its tasks, and the engines that perform them."""
