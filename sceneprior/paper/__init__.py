"""The paper's network, sections 3.1 to 3.3; `prior` assembles the other modules.

Symbols of the paper, here and in `losses`: z is a latent, w_i the weight of its anchor phi_i; x_k
is the feature of the k-th object and F_k the scene context from which it is generated; l_k, c_k,
s_k and p_k are the object's class, box centre, box size and completeness, and S_k its vertices. A
scene has N predictions; D_z is `width`.
"""
