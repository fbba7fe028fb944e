"""How does the compact network learn, and what leaves training of it?"""
