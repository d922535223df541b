"""Operations on run folders: evaluation, rendering, export, logging."""
