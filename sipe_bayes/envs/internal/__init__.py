"""What an extension brings into a model: states that nothing measures, joints that give way."""
