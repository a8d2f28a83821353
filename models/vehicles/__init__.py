"""Vehicle parameters: the shipped presets and their thruster curves."""
