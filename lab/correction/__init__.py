"""What corrections gain, cost and do wrong."""
