"""Which of two results do people prefer? A study that anyone can run, and what its answers say."""
