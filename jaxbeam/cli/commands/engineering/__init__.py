"""Commands about results that an engineer signs: code checks and influence lines."""
