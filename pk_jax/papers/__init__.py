"""Published results, computed again and compared cell by cell."""
