"""Results become tables, pictures, pages and players."""
