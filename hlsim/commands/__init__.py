"""The program's commands, a module each or a pair that belongs together."""
