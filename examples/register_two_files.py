"""Register two point-cloud files and look at how far to trust the answer.

python examples/register_two_files.py TARGET SOURCE MOVED
"""

import sys

from bbr_layer import BBRLayer, Detached, read_cloud, register, write_cloud

target_file, source_file, moved_file = sys.argv[1:4]
target, source = read_cloud(target_file), read_cloud(source_file)

# All points, whatever the unit; the files' own normals where they have some. BBRLayer.robust() tries more turns.
result = register(target, source, layer=BBRLayer(backward=Detached()))  # no gradients are asked for here

print(result.target_from_source.matrix)
print(f"{result.words}, with {int(result.buddies)} best buddies of {len(source.points)} points")
print(f"right with probability {float(result.confidence):.2f}, directions that nothing holds: {result.weak_directions}")
write_cloud(moved_file, result.target_from_source(source.points))
