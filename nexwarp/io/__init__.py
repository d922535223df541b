"""Files: written aside and renamed, JSON, pictures, video."""
