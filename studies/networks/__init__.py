"""The recipes of the shipped networks: each is trained, stored and described by one command."""
