"""Read recordings of any format behind one Protocol; frames stream, nothing loads a whole recording."""
