"""Bad inputs to every command: none may hang, crash, fill the memory, or be taken for a good one."""
