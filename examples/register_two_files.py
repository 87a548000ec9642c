"""Register two point-cloud files and look at how far to trust the answer.

python examples/register_two_files.py TARGET SOURCE MOVED
"""

import sys

import torch

from bbr_layer import BBRLayer, Detached, read_cloud, write_cloud

target_file, source_file, moved_file = sys.argv[1:4]
P, Q = (torch.from_numpy(read_cloud(path).points) for path in (target_file, source_file))

# The soft stage compares all pairs of points: a thousand of each cloud are enough to find the motion.
few_P, few_Q = (cloud[torch.randperm(len(cloud))[:1000]] for cloud in (P, Q))
layer = BBRLayer(backward=Detached())  # no gradients are asked for here
result = layer(few_P, few_Q)

# F alone takes many more points, and begins where the first registration ended.
many_P, many_Q = (cloud[torch.randperm(len(cloud))[:10_000]] for cloud in (P, Q))
result = BBRLayer("F", backward=Detached())(many_P, many_Q, start=result.target_from_source)

print(result.target_from_source.matrix)
print(f"{result.words}, with {int(result.buddies)} best buddies of {len(many_Q)} points")
write_cloud(moved_file, result.target_from_source(Q).numpy())
