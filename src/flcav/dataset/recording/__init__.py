"""Recording of datasets: the recorder, its jobs, and the engines that perform them."""
