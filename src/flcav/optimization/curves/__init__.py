"""Learning curves: models of the error by samples and rounds, their fit to history, and bootstrap bands."""
