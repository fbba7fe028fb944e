"""How does the compact network learn, and what does its training leave?"""
