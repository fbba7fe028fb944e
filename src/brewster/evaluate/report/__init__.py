"""How results are told: tables, a page to look at, and, apart from them, what others have published."""
