"""Pictures to look at: real and simulated ones, corrected by default and measured from outside."""
