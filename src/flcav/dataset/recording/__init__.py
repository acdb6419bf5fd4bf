"""Recording of datasets: jobs, workers, and the recorder that resumes."""
