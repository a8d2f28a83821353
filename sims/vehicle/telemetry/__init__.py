"""What the vehicle sends: the messages, and when each is due."""
