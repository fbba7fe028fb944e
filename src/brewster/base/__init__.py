"""What every room uses: errors of files, downloads, caches, settings, tables and executors."""
