"""The asset that a document makes: layers composed one over the other, results cached, scenes of several assets."""
