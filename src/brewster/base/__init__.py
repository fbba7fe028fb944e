"""What every room uses: files, downloads, caches, settings, tables and executors."""
