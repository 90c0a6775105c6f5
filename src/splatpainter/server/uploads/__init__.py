"""Files that come to the studio: uploaded, or saved in the folder that it watches."""
