"""A first sweep: record a stepped sine around a resonance, look at it, find the mode."""

# %% What is on the bench: the paper's three bodies, no dampers, a sweep of fifteen points around the second resonance
import analysis
import daq
import rig

scene = rig.load(
    "fig8-no-damper",
    {"test.from": "33 Hz", "test.to": "36.5 Hz", "test.points": 15, "converter.rate": "800 Hz"},
)
print(rig.explain(scene))

# %% Run the test as the real one would run: a controller that sees only channels holds the force
path = daq.record(scene, "recordings/first-sweep.mcap", overwrite=True)

# %% Frequency responses of all bodies, in one object: a line about it, a plot, a table
recording = daq.open(path)
frfs = analysis.frfs(recording)
print(frfs)
axes = frfs.plot()
table = frfs.to_dataframe()
print(table.head())

# %% The mode behind the peak, with what it may be off
modes = analysis.identify(frfs, count=1)
print(modes)
print(modes.to_dataframe())
