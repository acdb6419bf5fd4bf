"""Objects and signals along the roads of an OpenDRIVE map: signs, poles, signal heads, crosswalks, parking spaces."""
