"""What is measured with all of it: the paper, the survey, trials and certification."""
