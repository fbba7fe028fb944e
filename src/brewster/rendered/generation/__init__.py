"""How is a set rendered? A job, who does it (this process, several, or a cluster), and the overview of what was made."""
