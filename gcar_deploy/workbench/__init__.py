"""The page in the browser: see a case, correct it, run it again, hand it on."""
