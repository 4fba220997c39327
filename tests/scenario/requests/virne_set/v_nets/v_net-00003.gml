graph [
  node_attrs_setting "_networkx_list_start"
  node_attrs_setting [ name "cpu" type "resource" owner "node" low "0" high "100" ]
  topology___type "path"
  id 3
  arrival_time 7.0
  lifetime 2.0
  node [ id 0 label "0" cpu 60 ]
]
