"""Latents of TRELLIS as a PLY of Gaussians. Runs in VineDresser3D's environment and folder, not in this package's:

    python -c "$(cat decode_slat.py)" FEATS.pt COORDS.pt OUT.ply [MODEL]

Gaussians are written in TRELLIS's own frame (z up, -0.5..0.5), unturned.
"""

import importlib
import os
import sys

MODEL = "JeffreyXiang/TRELLIS-text-xlarge"


def main(feats: str, coords: str, out: str, model: str = MODEL) -> None:
    """feats, coords: tensors as main.py saves them; model: the pipeline that main.py decodes with."""
    os.environ.setdefault("SPCONV_ALGO", "native")
    torch = importlib.import_module("torch")
    sparse = importlib.import_module("trellis.modules.sparse")
    pipelines = importlib.import_module("trellis.pipelines")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    pipeline = pipelines.TrellisTextTo3DPipeline.from_pretrained(model)
    pipeline.to(device)
    features, coordinates = (torch.load(path, map_location=device, weights_only=True) for path in (feats, coords))
    decoded = pipeline.decode_slat(sparse.SparseTensor(feats=features, coords=coordinates), ["gaussian"])
    decoded["gaussian"][0].save_ply(out, transform=None)


if __name__ == "__main__":
    main(*sys.argv[1:])
