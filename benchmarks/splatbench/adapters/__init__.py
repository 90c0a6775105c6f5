"""Systems outside this package, each driven through its own command line in its own environment.

    config.py      the adapters file: where a system is
    call.py        a command: time limit, log, no process left behind
    views.py       the asset rendered from all around
    exchange.py    those pictures, cameras and points as the systems' loaders read them
    hull.py        voxels as a closed mesh
    alignment.py   a system's frame, and back to the asset's
    results.py     what comes back, as rows
    plans.py       what a system is given and which commands it is run with, as data
    voxhammer.py vinedresser.py dge.py instruct_gs2gs.py relitlrm.py     one plan each
    decode_slat.py runs in VineDresser3D's environment, not in this one

docs/ADAPTERS.md tells users what to do for each. No code of any of these systems is here.
"""
