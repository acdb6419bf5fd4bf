"""Light: from what rays meet to the colours of pixels. Colours are linear RGB unless a name says otherwise."""
