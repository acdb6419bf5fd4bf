"""Light: from what rays meet to the colours of pixels. Colours are linear red, green, blue unless a name says otherwise."""
