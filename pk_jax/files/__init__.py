"""What touches the disk and the terminal: run folders, written atomically, and progress lines."""
