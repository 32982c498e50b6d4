"""Speed and accuracy beside peers; run by ``make bench``."""
