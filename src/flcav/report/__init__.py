"""Results in, pictures and pages out; computes nothing."""
