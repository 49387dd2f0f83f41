"""Studies made with the library: the paper, the survey, trials and certification."""
