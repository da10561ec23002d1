"""Authentication and authorisation: keys, browser sessions, rate limits."""
