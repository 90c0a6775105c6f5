"""SplatPainter's nodes for ComfyUI: this folder is a custom node pack (see README.md)."""

from __future__ import annotations

from .nodes import NODES
from .schemas import has_v3, v1_class, v3_extension

if has_v3():
    # ComfyUI asks for the old names first, so a pack offers one of both.
    async def comfy_entrypoint():
        """The nodes, by the schema of `comfy_api.latest`."""
        return v3_extension(NODES)

else:
    NODE_CLASS_MAPPINGS = {node.id: v1_class(node) for node in NODES}
    NODE_DISPLAY_NAME_MAPPINGS = {node.id: node.display_name for node in NODES}
