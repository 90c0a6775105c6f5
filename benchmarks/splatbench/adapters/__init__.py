"""Systems outside this package, each driven through its own command line in its own environment.

    config.py        the adapters file: where a system is
    systems.py       what each system is given and which commands it is run with
    datasets.py      the asset as pictures, cameras, points and voxels that the systems' loaders read
    frames.py        a system's frame, and what comes back from it
    decode_slat.py   runs in VineDresser3D's environment, not in this one

docs/ADAPTERS.md tells users what to do for each. No code of any of these systems is here.
"""
