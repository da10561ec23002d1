"""Child processes that can do no harm: started, confined, watched."""
