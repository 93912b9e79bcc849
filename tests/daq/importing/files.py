"""Writers of foreign measurement files for tests: the same samples in every format, as other programs write them.

A writer takes a path and an array of samples (channels, samples) in the units of the file.
"""

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
import nptdms
import numpy as np
import pyuff
import soundfile
from mcap.writer import Writer
from scipy.io import savemat, wavfile

import rig

RATE = 2048.0  # Hz
NAMES = ("body1", "body2", "force")
UNITS = ("g", "m/s^2", "N")
SI_PER_UNIT = np.array([[9.80665], [1.0], [1.0]])


def make_scene(test="{kind: random, from: 5 Hz, to: 400 Hz, duration: 4 s, force: 1 N}", converter=""):
    """Return the scene of the imported measurement: two bodies and three channels."""
    return rig.loads(f"""
structure: {{masses: [1 kg, 2 kg], springs: [10 kN/m, 20 kN/m]}}
shaker: {{kind: force, body: 1}}
test: {test}
channels:
  - {{name: body1, at: body 1, accelerometer: {{sensitivity: 10 mV/g, sensitivity_tolerance: 0}}}}
  - {{name: body2, at: body 2, accelerometer: {{sensitivity: 10 mV/g, sensitivity_tolerance: 0}}}}
  - name: force
    at: {"hammer" if "impulse" in test else "shaker"}
    hammer: {{sensitivity: 2 mV/N, sensitivity_tolerance: 0}}
{converter}
""")


def random_samples(samples: int = 5000, seed: int = 1) -> np.ndarray:
    """Return white noise (3 channels, samples)."""
    return np.random.default_rng(seed).standard_normal((3, samples))


def write_tdms(path: Path, rows: np.ndarray) -> None:
    with nptdms.TdmsWriter(str(path)) as writer:
        # Several segments, as drivers write while they acquire.
        for segment in np.array_split(np.arange(rows.shape[1]), 3):
            writer.write_segment(
                [
                    nptdms.ChannelObject(
                        "Measured",
                        name,
                        row[segment],
                        {"wf_increment": 1.0 / RATE, "unit_string": unit, "wf_samples": 1},
                    )
                    for name, unit, row in zip(NAMES, UNITS, rows, strict=True)
                ]
            )


def write_tdms_with_times(path: Path, rows: np.ndarray) -> None:
    """Write columns without waveform properties, as programs without waveforms do."""
    columns = [("Time", "s", np.arange(rows.shape[1]) / RATE), *zip(NAMES, UNITS, rows, strict=True)]
    with nptdms.TdmsWriter(str(path)) as writer:
        for segment in np.array_split(np.arange(rows.shape[1]), 3):
            writer.write_segment(
                [
                    nptdms.ChannelObject("Measured", name, column[segment], {"unit_string": unit})
                    for name, unit, column in columns
                ]
            )


def write_uff(path: Path, rows: np.ndarray, binary: int = 0) -> None:
    file = pyuff.UFF(str(path))
    for number, (name, unit, row) in enumerate(zip(NAMES, UNITS, rows, strict=True), 1):
        file.write_sets(
            {
                "type": 58, "binary": binary, "func_type": 1, "id1": name, "rsp_node": number, "rsp_dir": 3,
                "ref_node": 0, "ref_dir": 0, "abscissa_spacing": 1, "abscissa_spec_data_type": 17,
                "ordinate_spec_data_type": 12, "ordinate_axis_units_lab": unit, "orddenom_spec_data_type": 0,
                "data": row, "x": np.arange(row.size) / RATE,
            },
            mode="add",
        )  # fmt: skip


def write_csv(path: Path, rows: np.ndarray) -> None:
    heading = ",".join(["time [s]", *(f"{name} [{unit}]" for name, unit in zip(NAMES, UNITS, strict=True))])
    np.savetxt(path, np.vstack([np.arange(rows.shape[1]) / RATE, rows]).T, "%.9g", ",", header=heading, comments="")


def write_german_csv(path: Path, rows: np.ndarray) -> None:
    """Write semicolons, decimal commas, a line of units and Windows' characters."""
    lines = ["Messung für Müller;;;", "Zeit;" + ";".join(NAMES), "ms;" + ";".join(UNITS)]
    for k, row in enumerate(rows.T):
        lines.append(";".join(f"{value:.9g}" for value in (1000 * k / RATE, *row)).replace(".", ","))
    path.write_text("\r\n".join(lines), encoding="cp1252")


def write_csv_with_dates(path: Path, rows: np.ndarray) -> None:
    """Write dates and times of day, full seconds without a fraction, and a comma after the last number."""
    lines = [",".join(["Date/Time", *(f"{name} ({unit})" for name, unit in zip(NAMES, UNITS, strict=True))])]
    begin = datetime(2024, 2, 29, 23, 59, 59, tzinfo=UTC).replace(tzinfo=None)
    for k, row in enumerate(rows.T):
        lines.append(f"{begin + timedelta(seconds=k / RATE)}," + "".join(f"{value:.9g}," for value in row))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_npz(path: Path, rows: np.ndarray) -> None:
    members = dict(zip(NAMES, rows, strict=True))
    np.savez(path, fs=RATE, channels=np.array(NAMES), units=np.array(UNITS), **members)


def write_mat(path: Path, rows: np.ndarray) -> None:
    units = {"channels": np.array(NAMES), "units": np.array(UNITS)}
    savemat(path, {**dict(zip(NAMES, rows, strict=True)), "t": np.arange(rows.shape[1]) / RATE, **units})


def write_mat_hdf5(path: Path, rows: np.ndarray) -> None:
    """Write a structure as MATLAB's `save -v7.3` does: columns are rows, texts are numbers, cells are references."""
    with h5py.File(path, "w", userblock_size=512) as file:
        run = file.create_group("run")
        run.attrs["MATLAB_class"] = np.bytes_("struct")
        for name, values in {**dict(zip(NAMES, rows, strict=True)), "fs": np.array([RATE])}.items():
            run.create_dataset(name, data=values[None]).attrs["MATLAB_class"] = np.bytes_("double")
        for key, texts in {"channels": [f"run.{name}" for name in NAMES], "units": UNITS}.items():
            cell = file.create_dataset(key, (1, len(texts)), h5py.ref_dtype)
            cell.attrs["MATLAB_class"] = np.bytes_("cell")
            for k, text in enumerate(texts):
                item = file.create_dataset(f"#refs#/{key}{k}", data=np.array([list(map(ord, text))], "u2").T)
                item.attrs["MATLAB_class"] = np.bytes_("char")
                cell[0, k] = item.ref
    header = b"MATLAB 7.3 MAT-file, Platform: PCWIN64".ljust(124) + b"\0\2IM"
    path.write_bytes(header + path.read_bytes()[len(header) :])


def write_wav(path: Path, rows: np.ndarray) -> None:
    wavfile.write(path, int(RATE), (rows / 8.0).T.astype(np.float32))


def write_sound(path: Path, rows: np.ndarray) -> None:
    soundfile.write(path, (rows / 8.0).T, int(RATE), subtype="PCM_24")


def write_mcap(path: Path, rows: np.ndarray) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for name, unit, row in zip(NAMES, UNITS, rows, strict=True):
            channel = writer.register_channel(f"/{name}", "json", 0, {"unit": unit})
            for first in range(0, row.size, 500):
                data = json.dumps({"sample_rate": RATE, "samples": row[first : first + 500].tolist()}).encode()
                time = round(first / RATE * 1e9)
                writer.add_message(channel, time, data, time)
        writer.finish()


# Extension, writer and relative error of each format.
WRITERS: dict[str, tuple[str, Callable[[Path, np.ndarray], None], float]] = {
    "tdms": (".tdms", write_tdms, 0.0),
    "tdms with times": (".tdms", write_tdms_with_times, 0.0),
    "uff text": (".uff", write_uff, 1e-11),
    "uff binary": (".uff", lambda path, rows: write_uff(path, rows, 1), 0.0),
    "csv": (".csv", write_csv, 1e-8),
    "csv from Germany": (".txt", write_german_csv, 1e-8),
    "csv with dates": (".csv", write_csv_with_dates, 1e-8),
    "npz": (".npz", write_npz, 0.0),
    "mat": (".mat", write_mat, 0.0),
    "mat 7.3": (".mat", write_mat_hdf5, 0.0),
    "wav": (".wav", write_wav, 1e-6),
    "w64": (".w64", write_sound, 2e-6),
    "flac": (".flac", write_sound, 2e-6),
    "mcap": (".mcap", write_mcap, 0.0),
}
