"""Match stereo pairs with several methods behind one Protocol; model noise, triangulate, and read and
write files.
"""
