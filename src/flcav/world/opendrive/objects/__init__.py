"""What an OpenDRIVE map has along its roads: signs, poles, signal heads, crosswalks and parking spaces."""
