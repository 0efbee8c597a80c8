"""Light and image faults as they occur in yards: settings, and their effects on an image."""
