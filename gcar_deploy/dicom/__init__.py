"""DICOM XA: X-ray angiography runs, classic and Enhanced, to pictures with their C-arm."""
