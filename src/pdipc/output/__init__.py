"""Results: run folders, pictures, exports, and the independent certificate."""
