"""The scale of a verification of the cells that takes only seconds."""

from hybridmap.verification import Scale

TINY = Scale(
    paths=1,
    distance_m=2.0,
    heading_steps=1000,
    still_steps=1000,
    overwrites=4,
    overwritten_drives=1,
    arena_m=1.0,
    lattice_pitch_m=0.03,
    lattice_cells=1,
    place_pitch_m=0.03,
    place_cells=64,
    place_epochs=1,
    room_m=(4.2, 2.0),
    room_pitch_m=0.03,
    noise=(0.01, 0.1),
    noise_repeats=1,
    noise_distance_m=6.0,
    laps_m=72.0,
    laps_alone_m=72.0,
    workers=1,
)
