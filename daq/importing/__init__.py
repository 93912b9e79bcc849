"""Time histories of real benches, in other programs' files, as recordings; knows no simulator.

Start with `import_files`: a file of any format gives `Signal`s, a table says which is which channel of the scene.
"""
