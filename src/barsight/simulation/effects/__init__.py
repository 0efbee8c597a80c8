"""Light and pictures as yards have them: settings, and what they do to a picture."""
