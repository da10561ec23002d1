"""Who asks, and what he may: keys, sessions of browsers, how often."""
