"""Trained weights; see MODEL_CARD.md."""
