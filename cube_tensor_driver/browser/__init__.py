"""The page that `./cube view` serves: viser and nothing else draws here."""
