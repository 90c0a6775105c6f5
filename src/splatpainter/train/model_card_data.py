"""Where the training data of the `compact` weights comes from, for its model card."""

OBJECTS = "Single objects, mostly furniture, tools, toys, packaging, vehicles. Few plants, creatures, people; no rooms."

SOURCES = """
Collections, with the licences of their files (all were converted, rescaled or re-encoded; none is non-commercial or
share-alike, as far as is known):

| what | from | licence |
|---|---|---|
| meshes | Google Scanned Objects (Google Research) | CC-BY-4.0 |
| meshes, textures | Gazebo models (Open Source Robotics Foundation and the authors below) | CC-BY-3.0 |
| meshes | AWS RoboMaker worlds: small house, bookstore, warehouse, racetrack, hospital | MIT-0 |
| meshes | ServiceSim, VRX (Open Source Robotics Foundation), Open-RMF, Project DAVE | Apache-2.0 |
| meshes | Poly Haven furniture, pmndrs market, KayKit, Kenney, Microsoft glTF samples | CC0-1.0 |
| meshes | Sketchfab models of the authors below, Babylon.js MeshesLibrary, Khronos fox | CC-BY-4.0 |
| meshes | PlayCanvas, WebXR input profiles | MIT |
| meshes | PX4 Gazebo models | BSD-3-Clause |
| environments | Poly Haven | CC0-1.0 |
| textures | Poly Haven, ambientCG, pmndrs market, PlayCanvas, Godot projects | CC0-1.0 |
| textures | Godot projects | MIT |
| stickers | Noto Emoji (Google) | Apache-2.0 |
| fonts | twelve display and handwriting fonts | OFL-1.1 |

Attribution for works under CC-BY, all of which were modified.

- CC-BY-4.0 (https://creativecommons.org/licenses/by/4.0/): Google Research (Google Scanned Objects); the Babylon.js
  team; PixelMannen, @tomkranis, @AsoboStudio and @scurest (fox); on Sketchfab: 4101929 ("colosseum"), CommonSpence
  ("Bar Table"), Fred Drabble ("PICTURE FRAME 15*20 dimensions"), Gwappa ("Medieval Fence"), Ryan_Nein ("Yamaha
  Keyboard"), Tiago Lopes ("Old Numeric Keypad"), jettrickdesign ("Big Ben"), Daz ("Low Poly Lumberjack"), purepoly
  ("Low Poly Tree with twisting branches"), soidev ("Portal Frame"), Omar Faruq Tawsif ("Still life, Based on Heather's
  artwork"), ar-watches ("Tag Heuer Monaco X GULF Watch").
- CC-BY-3.0 (https://creativecommons.org/licenses/by/3.0/), from the Gazebo models of the Open Source Robotics
  Foundation and contributors: Carlos Agüero, Christina Gomez, Cole Biesemeyer, Ian Chen, John Hsu, Louise Poubel, Nate
  Koenig, Peter Horak.

PX4 models: Copyright PX4 Autopilot for Drones. AWS RoboMaker models: Copyright Amazon.com, Inc. or its affiliates.
PlayCanvas assets: Copyright PlayCanvas Ltd. Noto Emoji: Copyright Google Inc. Some objects show trademarks of third
parties.
""".strip()
