"""Loop closure and refined self-motion from colour and depth: keyframes, registration, features, PnP."""
