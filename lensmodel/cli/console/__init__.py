"""What the commands share: options, output, signals, and how they fail."""
