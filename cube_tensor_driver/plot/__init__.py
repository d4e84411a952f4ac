"""Pictures as files: matplotlib and nothing else draws here."""
